"""Common part of the tasks assembly_1 and assembly_2: two parts are lifted and joined in the air. It registers no task."""
