"""The model gap: where model and measurement disagree, and which effect closes it."""
