"""Report of a comparison and a diagnosis: verdicts, figures, HTML page, JSON."""
