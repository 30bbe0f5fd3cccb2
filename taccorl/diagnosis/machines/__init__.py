"""Kinds of machines, one module each; ``taccorl.diagnosis.machines.machine`` says what a kind must be able to do."""
