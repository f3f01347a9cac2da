"""From finished cycles to location errors, error maps, reports and the model gap."""
