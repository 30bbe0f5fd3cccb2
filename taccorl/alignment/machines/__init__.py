"""Files that describe machines other than the PiPER: a driven axis, any robot of an MJCF or URDF file, a sensor of cells."""
