"""Dynamic measurements: continuous readings while a rotary axis turns (section 5.7.2)."""
