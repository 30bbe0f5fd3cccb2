"""Plug-ins: our folders and outside packages alike, found by name; a broken one is named and not passed over."""

import sys
from pathlib import Path

import pytest

from taccorl.errors import TaccorlError, nearest
from taccorl.plugins import ENTRY_POINT_GROUP, Registry
from tests.fresh_python import fresh_python

READER = '''
from taccorl.data.recording import Reader, readers

@readers.register("{name}")
class TextReader(Reader):
    """One message a line."""
    suffixes = (".lines",)

    def topics(self):
        return {{}}

    def messages(self, topics, *, stamps_only=(), start_ns=None, end_ns=None):
        yield from ()
'''
FIND = """
from pathlib import Path
import sys
from taccorl.data.recording import find_sources, readers
from taccorl.errors import TaccorlError
try:
    print(readers.get(sys.argv[1]).__name__)
    print(*[name for name, _ in find_sources(Path(sys.argv[2]))])
except TaccorlError as error:
    print("TaccorlError:", error)
"""


def install(folder: Path, package: str, code: str, **points: str) -> Path:
    """A distribution as pip leaves it: a module and a ``dist-info`` folder that names its entry points."""
    folder.mkdir(exist_ok=True)
    (folder / f"{package}.py").write_text(code)
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n"
    )
    lines = [f"{name} = {value}" for name, value in points.items()]
    (info / "entry_points.txt").write_text(
        "\n".join([f"[{ENTRY_POINT_GROUP}]", *lines, ""])
    )
    return folder


def find(site: Path, reader: str, path: Path) -> list[str]:
    """What a fresh Python that has ``site`` on its path prints."""
    run = fresh_python("-c", FIND, reader, path, path=site, cwd=site)
    assert run.returncode == 0, run.stderr
    return run.stdout.splitlines()


def test_an_outside_package_adds_a_reader_by_its_entry_point(tmp_path):
    site = install(
        tmp_path / "site",
        "lines_reader",
        READER.format(name="lines"),
        lines="lines_reader",
    )
    recording = tmp_path / "demo.lines"
    recording.touch()
    assert find(site, "lines", recording) == ["TextReader", "lines"]


def test_a_broken_outside_package_is_named_with_its_reason(tmp_path):
    site = install(
        tmp_path / "site",
        "broken_reader",
        "import no_such_module_here",
        mine="broken_reader",
    )
    (told,) = find(site, "mcap", tmp_path)
    assert told == (
        "TaccorlError: plug-in 'mine' (broken_reader) of entry-point group 'taccorl.plugins' cannot be imported: "
        "ModuleNotFoundError: No module named 'no_such_module_here'. Correct or uninstall it."
    )


def folder_of_plugins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, **modules: str
) -> Registry:
    """A registry whose plug-in folder is a package in ``tmp_path``; its modules find the registry in ``builtins``."""
    package = tmp_path / name
    package.mkdir()
    (package / "__init__.py").touch()
    for module, code in modules.items():
        (package / f"{module}.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    registry: Registry = Registry("sensor", name)
    monkeypatch.setattr("builtins.the_registry", registry, raising=False)
    return registry


REGISTER = "@the_registry.register('{0}')\nclass {0}: pass\n"


def test_every_module_of_the_folder_is_imported_when_a_name_is_asked_for(
    tmp_path, monkeypatch
):
    registry = folder_of_plugins(
        tmp_path,
        monkeypatch,
        "plugs_a",
        b=REGISTER.format("Bee"),
        a=REGISTER.format("Ant"),
    )
    assert "plugs_a" not in sys.modules  # nothing is imported before
    assert registry.get("Ant").__name__ == "Ant"
    assert list(registry) == ["Ant", "Bee"]


def test_an_unknown_name_names_the_nearest_or_all(tmp_path, monkeypatch):
    registry = folder_of_plugins(
        tmp_path, monkeypatch, "plugs_b", a=REGISTER.format("flexitac")
    )
    with pytest.raises(
        TaccorlError, match=r"^no sensor 'flexitack'; did you mean 'flexitac'"
    ):
        registry.get("flexitack")
    with pytest.raises(TaccorlError, match=r"^no sensor 'camera'; known: flexitac$"):
        registry.get("camera")


def test_two_plugins_of_one_name_are_refused_and_the_same_twice_is_not(
    tmp_path, monkeypatch
):
    registry = folder_of_plugins(tmp_path, monkeypatch, "plugs_c", a="", b="")
    first = registry.register("x")(int)
    assert first is int  # a decorator that leaves the class as it is
    registry.register("x")(int)
    with pytest.raises(
        TaccorlError, match=r"sensor 'x' is registered twice: .*int.* and .*float"
    ):
        registry.register("x")(float)
    assert registry.get("x") is int


def test_a_plugin_that_fails_half_way_gives_the_same_error_again(tmp_path, monkeypatch):
    registry = folder_of_plugins(
        tmp_path,
        monkeypatch,
        "plugs_e",
        a=REGISTER.format("Ant") + "import no_such_module_here\n",
    )
    for _ in range(2):
        with pytest.raises(ModuleNotFoundError, match="no_such_module_here"):
            registry.get("Ant")


def test_a_plugin_may_look_others_up_while_it_is_imported(tmp_path, monkeypatch):
    code = REGISTER.format("Ant") + "assert the_registry.get('Ant') is Ant\n"
    registry = folder_of_plugins(
        tmp_path, monkeypatch, "plugs_d", a=code, b=REGISTER.format("Bee")
    )
    assert list(registry) == ["Ant", "Bee"]


@pytest.mark.parametrize(
    ("name", "known", "expected"),
    [
        ("flexitac_v3", ["flexitac_v2", "uskin"], "did you mean 'flexitac_v2'?"),
        ("zzz", ["b", "a"], "known: a, b"),
        ("zzz", [], "known: none"),
        ("", ["a"], "known: a"),
        ("1", [1, 2], "did you mean '1'?"),
    ],
)
def test_nearest(name, known, expected):
    assert nearest(name, known) == expected
