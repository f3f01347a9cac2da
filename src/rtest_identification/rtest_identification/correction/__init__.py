"""Commands changed so that the predicted error of a machine vanishes to first order."""
