"""Pictures: recordings for Rerun, figures, and the report of a run."""
