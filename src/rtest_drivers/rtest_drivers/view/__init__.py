"""What a person sees of a running cell: its state, thinned, and the page that shows it."""
