"""What people look at: films, 3D pages, gait sheets, the live viewer and the learning curves of one run.

Training, scoring, and formats that other software reads do not belong here.
"""
