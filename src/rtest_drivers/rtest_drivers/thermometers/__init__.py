"""Thermometers on serial lines."""
