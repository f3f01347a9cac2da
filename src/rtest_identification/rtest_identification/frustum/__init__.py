"""What a machine's errors do to a machined part: the cone frustum test and other features."""
