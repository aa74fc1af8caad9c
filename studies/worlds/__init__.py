"""Writers of recordings whose physics is not that of meshskin, for studies/foreign_worlds.py.

They use NumPy, SciPy and other people's solvers; of meshskin only the table that holds a recording.
"""
