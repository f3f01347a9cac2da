"""Laser sensors nest: displacement lasers that look at the sphere (chapter 5).

A contact gauge with a flat probe reads a projection of the sphere centre; a laser reads where its
beam meets the sphere, which also depends on how far the centre lies beside the beam.
"""

from rtest_estimation.laser.calibration import calibrate
from rtest_estimation.laser.solver import CentreSolver, CentreStatus, centres

__all__ = ['CentreSolver', 'CentreStatus', 'calibrate', 'centres']
