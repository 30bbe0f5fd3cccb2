"""Card of a dataset, written by every verb that makes one. A failure to write it is printed, not raised, because the dataset is
complete without it."""

from pathlib import Path

from taccorl.errors import TaccorlError, printable


def add_card(root: Path) -> None:
    """Write a dataset's ``README.md`` (its card) beside its ``meta/`` and print its path; an existing README.md is not
    changed."""
    from taccorl.views.card import write_card

    try:
        path = write_card(root)
    except (TaccorlError, OSError) as error:
        print(f"card:    not written: {printable(error)}")
        return
    if path is not None:
        print(f"card:    {path}")
