"""Few demonstrations into many: MimicGen for two hands that feel, with held objects carried over instead of hands.

Meaning and field names are IsaacLab Mimic's (DexMimicGen): each arm has subtasks, constraints tie them together. Read ``spec``
for what can be asked for, ``director`` for what is done with it, ``attempt`` for how it runs in the twin.
"""
