"""``taccorl <verb> …``: one file per verb, imported only when it is asked for, so that the list appears at once."""

import errno
import importlib
import os
import shutil
import signal
import sys
import warnings

from taccorl.cli.output_lock import released_at_the_end
from taccorl.cli.printed import form_of, printed
from taccorl.errors import TaccorlError, nearest, printable

VERBS = {
    "twin": {
        "collect": "demonstrations in the MuJoCo twin → LeRobot dataset, or recordings as the robot's drivers write them",
        "task": "`task new NAME` writes a working task of your own, which collect, augment and evaluate then know",
        "augment": "a few demonstrations from the twin → many new ones (MimicGen)",
        "correct": "the expert takes over where a policy fails → dataset of its corrections (DAgger)",
        "evaluate": "success rate of a policy in the twin, its interval, failures; comparison of two policies on the same scenes",
        "post-train": "a policy → a better one: PPO in the twin, kept close to real demonstrations",
        "init-robot": "MJCF or URDF of your own robot → a robot file for compare, diagnose and add-effect",
        "compare": "differences between the twin and measurements: table, report, Rerun overlay",
        "align": "gains of joints, stiffness of pads and poses of cameras, fitted to measurements → a new twin",
        "diagnose": "the physical effect that the twin lacks, its evidence, and effects that cannot be separated",
        "add-effect": "add an effect with its fitted values to the twin",
        "effects": "the physical effects that can be found; `effects new NAME` writes an example of your own",
        "excite": "the motion to record next, so that two effects can be separated",
        "surrogate": "recordings of a simulated robot with hidden effects, to try diagnose without a robot",
        "serve-surrogate": "a simulated robot with hidden effects in real time, for lerobot-record and lerobot-rollout",
    },
    "data": {
        "ingest": "recordings → LeRobot dataset with touch; `ingest inspect FILE` shows the contents of one",
        "check": "find faults of a recording or a dataset",
        "merge": "real and simulated datasets → one for co-training, with each row marked, and exact statistics",
        "view": "an episode in Rerun: pictures, touch, joints, arms",
    },
    "store": {
        "lineage": "inputs of every result: `lineage explain PATH`; delete unneeded ones: `lineage prune`"
    },
}
"""Heading of the list of commands → verb → description."""
SECOND_WORDS = {
    "effects": ("new",),
    "ingest": ("inspect",),
    "lineage": ("explain", "prune"),
    "task": ("new",),
}
"""Verb → its second words, such as ``explain`` of ``taccorl lineage explain``."""

ONE_THREAD = ("compare", "align", "diagnose", "excite")
"""Verbs whose linear algebra runs in one thread unless the environment states another number: their matrices have some ten
columns, and threads that wait for work doubled the CPU time of ``diagnose``."""
_KEEPS = ("collect", "augment", "correct", "ingest", "merge")
"""Verbs that keep finished work in a store."""


def main(argv: list[str] | None = None) -> int:
    """Run one verb of the command line, and return its exit status.

    0: done. 1: done, but something was quarantined, refused or found wrong. 2: not done because of an error. 130: stopped by
    Ctrl-C. 143: ended by a signal (SIGTERM). 141: the reader of the output closed it (``taccorl … | head``). ``argv``: the
    verb and its arguments; None: those of the process."""
    if argv is None:  # we are the program and not a guest in somebody's process
        os.environ["TACCORL_PROGRAM"] = "1"
        signal.signal(
            signal.SIGTERM, _ended
        )  # what is unfinished is removed, as after Ctrl-C
        argv = sys.argv[1:]
        if not sys.warnoptions:  # NumPy's notes on empty means and the like
            os.environ["PYTHONWARNINGS"] = "ignore::RuntimeWarning"  # of workers
            warnings.simplefilter("ignore", RuntimeWarning)
        for library in (
            ("OMP", "OPENBLAS", "MKL") if argv and argv[0] in ONE_THREAD else ()
        ):  # before NumPy is imported
            os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    words = argv
    if words in (["--version"], ["-V"]):
        from taccorl import __version__

        print(f"taccorl {__version__}")
        return 0
    known = [verb for group in VERBS.values() for verb in group]
    if words[:1] == ["help"]:  # taccorl help ingest inspect
        words = [*words[1:], "--help"]
    listing = not words or words[0] in ("-h", "--help")
    if not listing and words[0] not in known:
        print(
            f"taccorl: no verb {words[0]!r}; {nearest(words[0], known)}",
            file=sys.stderr,
        )
        return 2
    typed = " ".join(
        [
            "taccorl",
            *words[:1],
            *(w for w in words[1:2] if w in SECOND_WORDS.get(words[0], ())),
        ]
    )
    try:
        words, form = form_of(words)
        with released_at_the_end(), printed(form):
            module = "" if listing else words[0].replace("-", "_")
            code = (
                _list_verbs()
                if listing
                else importlib.import_module(f"taccorl.cli.{module}").main(words[1:])
            )
        sys.stdout.flush()  # a closed pipe shows here at the latest
        return code
    except ModuleNotFoundError as error:
        from taccorl.extras import missing

        if not (line := missing((error.name or "").partition(".")[0])):
            raise
        print(f"{typed}: {line}", file=sys.stderr)
        return 2
    except SystemError:  # compiled code wraps what a signal raises in it
        if not _signals:
            raise
        return 128 + _signals[0]
    except KeyboardInterrupt:
        kept = (
            "; what was finished is kept, run again to go on"
            if words[0] in _KEEPS
            else ""
        )
        print(f"\n{typed}: stopped{kept}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `taccorl … | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (TaccorlError, OSError) as error:
        text = _of_machine(error) if isinstance(error, OSError) else error
        print(f"{typed}: {printable(text)}", file=sys.stderr)
        return 2


_signals: list[int] = []  # that have come to end the process


def _ended(number: int, frame: object) -> None:
    _signals.append(number)
    sys.exit(128 + number)


def _of_machine(error: OSError) -> str:
    """What the machine refused, and where; of a copy of many files (``shutil.Error``) the first one."""
    text, place = error.strerror or str(error), error.filename
    if (
        isinstance(error, shutil.Error)
        and error.args
        and isinstance(error.args[0], list)
        and error.args[0]
    ):
        _, place, text = error.args[0][0]
    full = os.strerror(errno.ENOSPC)
    advice = "; make room, then run the same command again" if full in text else ""
    return f"{full if advice else text}{f' ({place})' if place else ''}{advice}"


def _list_verbs() -> int:
    print(
        "usage: taccorl <verb> [what] [--option=value …]      taccorl <verb> --help\n"
    )
    for group, verbs in VERBS.items():
        print(group)
        for verb, line in verbs.items():
            print(f"  {verb:16s}{line}")
    print(
        "\nevery verb: --quiet prints no result; --json, of those with a report, prints it as JSON\n"
        "training is LeRobot's own command: lerobot-train; lerobot-eval scores as taccorl evaluate does"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
