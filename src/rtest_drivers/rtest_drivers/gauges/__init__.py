"""Gauges on serial lines: transport, protocols, and the nest that several controllers form."""
