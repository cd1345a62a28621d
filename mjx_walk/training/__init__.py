"""The host loop, the compiled programs that it calls, and the processes and devices where they run.

What a run leaves on the disk is defined in `storage`; gradients and physics are not here.
"""
