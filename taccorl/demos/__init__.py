"""Demonstrations. Today: the stand-in recording that takes the twin's place until there is one."""
