"""Names of other people's topics and files never steer the terminal, and drafts that hold them are YAML."""

import json
import re
from pathlib import Path

import yaml
from mcap.writer import Writer

from taccorl.cli.main import main
from taccorl.errors import printable

RED, BELL, BACKWARDS, C1 = "\x1b[31m", "\x07", "\u202e", "\x9b2J"
TOPIC = f"/arm{RED}/joint{BELL}_state{BACKWARDS}{C1}\nrow: 2"
TEXTS = f"/other{RED}"
STEERS = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e]")


def write(path: Path) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        joints = writer.register_schema(f"sensor_msgs/msg/JointState{RED}", "jsonschema", b"{}")
        other = writer.register_schema("my_msgs/Unknown", "jsonschema", b"{}")
        message = {"name": [f"joint{RED}"], "position": [0.5]}
        for topic, schema in ((TOPIC, joints), (TEXTS, other)):
            channel = writer.register_channel(topic, "json", schema)
            for k in range(20):
                writer.add_message(channel, 10**18 + k * 10**7, json.dumps(message).encode(), publish_time=0)
        writer.add_metadata(f"note{RED}", {"by": f"{RED}me"})
        writer.finish()
    return path


def test_printable_writes_out_what_a_terminal_would_obey():
    assert printable(f"a{RED}b\n{BACKWARDS}") == r"a\x1b[31mb\n\u202e"
    assert printable("Größe → 3 µm, 😀") == "Größe → 3 µm, 😀"
    assert printable("\udcff") == r"\udcff"  # a file name that is not UTF-8


def test_what_inspect_prints_and_drafts_has_no_control_characters(tmp_path, capsys):
    path = write(tmp_path / f"a{RED}.mcap")
    assert main(["ingest", "inspect", str(path)]) == 0
    assert main(["ingest", "inspect", str(path), f"--draft={tmp_path / 'mine.yaml'}"]) == 0
    printed = capsys.readouterr().out
    assert not STEERS.search(printed)
    assert r"/arm\x1b[31m/joint\x07_state\u202e\x9b2J\nrow: 2" in printed
    for name in ("mine.yaml", "mine_dataset.yaml"):
        assert not STEERS.search((tmp_path / name).read_text())
        assert yaml.safe_load((tmp_path / name).read_text())
    (channel,) = yaml.safe_load((tmp_path / "mine.yaml").read_text())["channels"].values()
    assert channel["topic"] == TOPIC
    assert channel["pick"] == [f"joint{RED}"]
    assert r"# not used: /other\x1b[31m" in (tmp_path / "mine.yaml").read_text()


def test_errors_reports_and_lists_of_what_is_not_read_have_none_either(tmp_path, capsys):
    folder = tmp_path / "in"
    folder.mkdir()
    write(folder / f"a{RED}.mcap")
    (folder / f"b{RED}.txt").write_text("?")
    for words in (["ingest", "--dry_run=true"], ["check"]):
        assert main([words[0], str(folder), "--spec=piper_flexitac_mcap", *words[1:]]) == 1
    assert main(["check", str(folder / f"c{RED}")]) == 2
    captured = capsys.readouterr()
    assert not STEERS.search(captured.out + captured.err)
    assert r"a\x1b[31m.mcap" in captured.out and r"b\x1b[31m.txt" in captured.out and r"c\x1b[31m" in captured.err
