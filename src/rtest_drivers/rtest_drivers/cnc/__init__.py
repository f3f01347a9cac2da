"""Encoder feedback of real controllers: LinuxCNC, OPC UA, MTConnect.

For each controller the protocol (bytes or text to positions), the transport and the backend of the
CNC driver are things of their own.
"""
