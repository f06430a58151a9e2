"""Command lines of the commands: what can be asked for, known without importing how it is done.

Nothing here imports torch, numpy, a simulator or a file format when it is imported. Choices are
written out in `choices`, so that a mistyped one is found before any work.
"""
