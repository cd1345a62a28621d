"""The generated parts of the documentation: tables of tasks and settings, from the code that defines them.

Words that only people can write are in the pages themselves, and for task pages in `task_texts`.
"""
