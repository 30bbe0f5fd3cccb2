"""What verbs check before they work on measurements."""

import numpy as np
import pytest
from made_rows import of_signal

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.cli.measured import refuse_long
from taccorl.data.origin import Origin
from taccorl.errors import TaccorlError


def at_rest(rows: int) -> Measurement:
    still = np.zeros(rows)
    return of_signal("long.csv", 1000.0, still, still, "drive", "m", origin=Origin("twin", "no robot"))


def test_a_recording_of_more_rows_than_a_diagnosis_replays_is_refused_with_its_numbers():
    refuse_long(Measurements((at_rest(500_000),)))
    with pytest.raises(TaccorlError, match=r"long\.csv.*500001 rows, 500 s.*500000.*10 s"):
        refuse_long(Measurements((at_rest(1000), at_rest(500_001))))
