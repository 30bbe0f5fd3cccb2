"""Work for ``pipelines.worker_processes`` that succeeds, raises, dies or hangs; imports next to nothing, to start at once."""

import os
import time


def work(job: str) -> str:
    """Does what the job says."""
    if job == "raise":
        raise ValueError("no such robot")
    if job == "die":
        os._exit(7)
    if job == "hang":
        time.sleep(600)
    return job.upper()
