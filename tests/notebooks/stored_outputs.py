"""``make notebooks [ONLY=2]``: run the notebooks (those whose name begins so) and store their outputs, small and comparable.

Stored are texts and pictures. Not stored: what is written to stderr (progress, warnings of libraries), names of temporary
folders, times of execution. A cell whose numbers differ from run to run or machine to machine has the tag ``numbers vary``.
"""

import base64
import io
import math
import re
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "notebooks"
VARIES = "numbers vary"
_TEMPORARY = re.compile(re.escape(tempfile.gettempdir()) + r"/tmp\w{8}")
_ESCAPES = re.compile(r"\x1b\[[0-9;]*m")
_NUMBER = re.compile(r"(?<![\w.])[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def executed(path: Path) -> NotebookNode:
    """The notebook, run from top to bottom in the clone, with outputs as they are stored. Raises CellExecutionError: a cell
    failed, or took longer than 900 s."""
    notebook = nbformat.read(path, as_version=4)
    metadata = notebook.metadata.copy()
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(ROOT)}}).execute()
    notebook.metadata = metadata  # not the version of this Python
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = _stored(cell.outputs)
    return notebook


def _stored(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """Texts one after the other in one piece, pictures as PNG; the rest is left out."""
    kept: list[NotebookNode] = []
    for output in outputs:
        data = output.get("data", {})
        if "image/png" in data:
            kept.append(nbformat.v4.new_output("display_data", data={"image/png": _small(data["image/png"])}))
            continue
        text = output.get("text", "") if output.get("name") == "stdout" else data.get("text/plain", "")
        text = _TEMPORARY.sub("/tmp/…", _ESCAPES.sub("", text))
        if text and kept and kept[-1].output_type == "stream":
            kept[-1].text += text
        elif text:
            kept.append(nbformat.v4.new_output("stream", name="stdout", text=text))
    return kept


def _small(png: str) -> str:
    """The picture with 255 colours."""
    picture = Image.open(io.BytesIO(base64.b64decode(png)))
    white = Image.new("RGBA", picture.size, "white")
    white.alpha_composite(picture.convert("RGBA"))
    written = io.BytesIO()
    white.convert("RGB").quantize(255, dither=Image.Dither.NONE).save(written, "PNG", optimize=True)
    return base64.b64encode(written.getvalue()).decode()


def pictures(cell: NotebookNode) -> list[bytes]:
    """PNG pictures among the outputs of a code cell."""
    return [base64.b64decode(o.data["image/png"]) for o in cell.outputs if "image/png" in o.get("data", {})]


def differences(stored: NotebookNode, now: NotebookNode) -> list[str]:
    """Cells whose text or number of pictures is not as stored: words equal, numbers equal to 1 %."""
    found = []
    for k, (old, new) in enumerate(zip(stored.cells, now.cells, strict=True)):
        if old.cell_type != "code":
            continue
        before, after = ("\n".join(o.text for o in cell.outputs if o.output_type == "stream") for cell in (old, new))
        if len(pictures(old)) != len(pictures(new)):
            found.append(f"cell {k}: {len(pictures(old))} pictures are stored, {len(pictures(new))} appear now")
        if not same_text(before, after, numbers=VARIES not in old.metadata.get("tags", [])):
            found.append(f"cell {k}: stored is\n{before}\nand now it prints\n{after}")
    return found


def same_text(before: str, after: str, *, numbers: bool) -> bool:
    """Whether the words are the same, whatever the spaces, and with ``numbers`` each number to 1 %."""
    words = [_NUMBER.sub("#", text).split() for text in (before, after)]
    values = [[float(n.replace("−", "-")) for n in _NUMBER.findall(text)] for text in (before, after)]
    if words[0] != words[1]:
        return False
    return not numbers or all(math.isclose(a, b, rel_tol=0.01) for a, b in zip(*values, strict=True))


def main(prefix: str = "") -> None:
    """Run the notebooks whose names begin with ``prefix``, and write them with their outputs."""
    for path in sorted(FOLDER.glob(f"{prefix}*.ipynb")):
        nbformat.write(executed(path), path)
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
