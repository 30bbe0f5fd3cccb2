"""Write .rrd files with errors raised: Rerun's own writer continues when the disk is full, and only logs it."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from taccorl.views.outputs import APPLICATION


@contextlib.contextmanager
def recording_to(rrd: Path, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """A recording that is gathered in memory and written to ``rrd`` when the context ends without an error.

    Raises:
        OSError: ``rrd`` cannot be written, or not to its end.
    """
    with rr.RecordingStream(APPLICATION) as rec:
        stream = rec.binary_stream()
        # active, too: as the default alone, the web viewer shows its own arrangement instead
        rec.send_blueprint(blueprint, make_active=True, make_default=True)
        yield rec
        content = stream.read()  # once: each reading ends with a footer that counts from its own beginning
    assert content is not None  # not even the blueprint came
    rrd.write_bytes(content)
