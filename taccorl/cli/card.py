"""Card of a dataset, written by every verb that makes one. A dataset is whole without: a fault is printed, not raised."""

from pathlib import Path

from taccorl.errors import TaccorlError, printable


def add_card(root: Path) -> None:
    """Write ``README.md`` beside ``meta/`` and print where; a README.md that is there already stays as it is."""
    from taccorl.views.card import write_card

    try:
        path = write_card(root)
    except (TaccorlError, OSError) as error:
        print(f"card:    not written: {printable(error)}")
        return
    if path is not None:
        print(f"card:    {path}")
