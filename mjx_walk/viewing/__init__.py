"""Pictures of a run: films, 3D pages, gait sheets, the live viewer and learning curves.

Training, scoring, and formats that other software reads do not belong here.
"""
