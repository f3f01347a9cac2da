"""Everything that touches the world: gauges, CNC, recorder, replay, simulated cell."""
