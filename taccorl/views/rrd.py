"""An .rrd file that we put in its place ourselves: Rerun's own writer goes on when the disk is full, and only logs it."""

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from taccorl.views.outputs import APPLICATION

SPARE_BYTES = 1 << 20
"""Free on the scratch disk after writing: with less, Rerun may have left something out."""


@contextlib.contextmanager
def recording_to(rrd: Path, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """A recording that Rerun writes to a scratch file, copied to ``rrd`` when the context ends without an error.

    Raises:
        OSError: ``rrd`` cannot be written, or not to its end; or the scratch disk is full.
    """
    with tempfile.TemporaryDirectory(prefix="taccorl_") as folder:
        scratch = Path(folder) / "scratch.rrd"
        with rr.RecordingStream(APPLICATION) as rec:
            rec.save(scratch, default_blueprint=blueprint)
            yield rec
            rec.disconnect()
        if shutil.disk_usage(folder).free < SPARE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), folder)
        shutil.copyfile(scratch, rrd)
