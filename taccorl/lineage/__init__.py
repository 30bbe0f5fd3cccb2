"""Provenance of results: a content-addressed store of finished work, its lineage, and engines that run stages.

A *stage* (`stage`) is a named step; its *artefact* is the folder it made, with a *manifest* (`manifest`) inside. The
*store* (`store`) keeps each artefact under a *key* of stage, version, config (`canonical`) and input *digests*
(`digest`). `explain` shows an artefact's *lineage*, `prune` deletes artefacts that no dataset needs, an *engine* (`engines`)
runs a stage over many inputs. `processes` (worker processes) is internal.
"""
