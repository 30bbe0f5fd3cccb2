"""What was made from what: a content-addressed store, explained, on any engine.

A *stage* (`stage`) is a named step; its *artefact* is the folder it made, with a *manifest* (`manifest`) inside. The
*store* (`store`) keeps each artefact under a *key* of stage, version, config (`canonical`) and input *digests*
(`digest`). `explain` shows an artefact's *lineage*, `prune` frees what nobody needs, an *engine* (`engines`) runs a
stage over many inputs. Two things are for the few: `processes` (worker processes) and `cluster` (Slurm, Ray).
"""
