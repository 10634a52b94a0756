"""Speed beside the peers, on the same work, in one run: ``python -m benchmarks [name ...]``.

Every module here (but those that start with an underscore) has ``run()``, which returns a list of `_table.Row`.
"""
