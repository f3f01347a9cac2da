"""Thermal sessions: one short cycle again and again while the machine warms up (chapter 4)."""
