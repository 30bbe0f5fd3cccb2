"""MimicGen for two hands: generate many demonstrations from few. The path of the held object is transferred, not that of the
hand.

Meaning and field names are IsaacLab Mimic's (DexMimicGen): each arm has subtasks, constraints tie them together. ``spec``
has the settings, ``director`` applies them, ``attempt`` runs them in the twin.
"""
