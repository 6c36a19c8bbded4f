"""Pictures of results for a notebook: arrays and frames in, matplotlib's axes out."""
