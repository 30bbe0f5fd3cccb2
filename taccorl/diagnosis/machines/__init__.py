"""Kinds of machines, one module each; ``taccorl.diagnosis.machines.machine`` defines the methods of a kind."""
