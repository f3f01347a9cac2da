"""Figures of an identification: a module a kind, one function a figure."""
