"""What a person sees of a run: figures, tables, videos."""
