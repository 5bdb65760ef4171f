"""Mitsuba integrators written in Python: surface paths, participating media, and light tracing from surfaces."""
