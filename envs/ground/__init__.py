"""Ground that is not flat: slopes, steps and rough ground, harder the farther a body gets.

The shape of the ground, its heights and the places where episodes start belong here.
Contacts with it belong to `physics`.
"""
