"""Diagnosis: where a twin deviates from measurements, which effect it lacks, and what to record next."""
