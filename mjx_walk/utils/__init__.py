"""Small tools and types that every other package may use: errors, text, checked fields of settings, collectives.

Code that depends on tasks, runs or the machine belongs in another package.
"""
