"""Recording formats, one file each: register a ``Reader`` with ``@readers.register("name")`` to add one."""
