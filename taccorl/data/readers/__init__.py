"""Recording formats, one file each: register a ``Reader`` with ``@readers.register("name")`` and it takes part."""
