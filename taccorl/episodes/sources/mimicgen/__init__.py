"""MimicGen for two hands: generate many demonstrations from few. The path of the held object is transferred, not that of the
hand.

Concepts and field names are those of IsaacLab Mimic (DexMimicGen): each arm has subtasks, and constraints order them. ``spec``
has the settings, ``director`` applies them, ``attempt`` runs them in the twin.
"""
