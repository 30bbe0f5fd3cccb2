"""Camera calibration (paper App. B.3): pose, exposure, sharpness and latency of a camera."""
