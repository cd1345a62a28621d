"""The machine below a program: devices, drivers, OpenGL, processes, signals, and the supported releases of JAX.

Nothing here knows tasks, runs or commands.
"""
