"""Tables and figures of the benchmark; `plot.py` is the command. Each file has one job.

`paper` (names, colours and numbers of the paper), `grouping` (which runs belong together), `tables` and `style`
(rendering), `rewards`, `definitions` (what stands in the tables), `figures` (curves), `statistics` and `aggregates`
(over tasks: numbers, and their tables and figures), `illustrations` (maps and actions), `runtime` (the runtime
experiment).
"""
