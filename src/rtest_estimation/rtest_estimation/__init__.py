"""From gauge readings to the sphere centre and the finished cycle."""
