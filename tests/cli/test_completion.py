"""What shells complete: the options that each verb takes, found without importing the verbs."""

import dataclasses
import importlib
import shutil
import subprocess
import typing

import pytest

from taccorl.cli.completion import options_of
from taccorl.cli.main import VERBS, main
from taccorl.cli.parse import _inner_names
from tests.fresh_python import fresh_python

CONFIGS = {
    "augment": "AugmentConfig",
    "evaluate": "EvaluateConfig",
    "add-effect": "AddEffectConfig",
    "post-train": "PostTrainConfig",
    "view": "ViewConfig",
}
LAST_WORD = {  # prints what the shell offers for the last of these words
    "bash": "source {script}; COMP_WORDS=({line}); COMP_CWORD=$((${{#COMP_WORDS[@]}}-1)); _taccorl 2>/dev/null; "
    "printf '%s\\n' \"${{COMPREPLY[@]}}\"",
    "fish": "source {script}; complete -C '{line}'",
}


@pytest.mark.parametrize("verb", CONFIGS)
def test_options_read_from_source_are_those_of_the_config(verb):
    kind = getattr(importlib.import_module(f"taccorl.cli.{verb.replace('-', '_')}"), CONFIGS[verb])
    expected = {"config_path"}
    for field, hint in typing.get_type_hints(kind).items():
        inner = _inner_names(hint)
        nested = {name for name in inner if not any(other.startswith(f"{name}.") for other in inner)}
        expected |= {f"{field}.{name}" for name in nested} or {field}
    assert set(options_of(verb)) == expected
    assert {field.name for field in dataclasses.fields(kind)} == {
        name.split(".")[0] for name in expected - {"config_path"}
    }


def test_the_script_is_made_without_any_library():
    heavy = "{'numpy', 'torch', 'lerobot', 'draccus', 'rich', 'yaml', 'taccorl.cli.collect'}"
    code = f"import sys; from taccorl.cli.main import main; main(['completion', 'bash']); print({heavy} & set(sys.modules))"
    assert fresh_python("-c", code).stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize("shell", LAST_WORD)
def test_a_shell_offers_verbs_options_words_and_files(shell, tmp_path, capsys):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    assert main(["completion", shell]) == 0
    script = tmp_path / "script"
    script.write_text(capsys.readouterr().out)
    (tmp_path / "a file.mcap").touch()

    def offered(*words: str) -> str:
        flags = ["--norc"] if shell == "bash" else ["--no-config"]
        command = [shell, *flags, "-c", LAST_WORD[shell].format(script=script, line=" ".join(words))]
        return subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stdout.strip()

    assert offered("taccorl", "colle").split()[0] == "collect"
    assert offered("taccorl", "collect", "--epi").rstrip("=") == "--episodes"
    assert offered("taccorl", "post-train", "--ppo.kl").rstrip("=") == "--ppo.kl_stop"
    assert offered("taccorl", "lineage", "pru") == "prune"
    assert "a file.mcap" in offered("taccorl", "check", "a").replace("\\", "")


def test_every_verb_has_options_or_words():
    for group in VERBS.values():
        for verb in group:
            assert (verb == "completion") != bool(options_of(verb)), verb


def test_what_a_class_alone_knows_is_no_option():
    assert "source.repeatable" not in options_of("collect")  # a ClassVar
