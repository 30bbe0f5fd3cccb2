"""Diagnosis: where the twin fails, which effect it lacks, and what to record next."""
