"""A simulated machine cell: machine with geometric errors, gauges, encoders. It is the truth.

It shares no numerics with estimation and identification; from them it takes the machine file's
reader and the records only. Nothing outside the node `cell` imports it at run time.
"""
