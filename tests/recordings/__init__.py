"""Synthetic recordings in the formats of a bimanual PiPER's drivers, with known true signals and optional faults."""
