"""What a laser nest is worth, from a recording: verification points and scans over the sphere."""
