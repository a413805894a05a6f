"""Tables and figures of the benchmark; `plot.py` is the command. Each file has one job.

`paper` (names, colours and numbers of the paper), `grouping` (which runs belong together), `tables` (rendering),
`rewards` and `definitions` (what stands in the tables), `statistics` (aggregates over tasks), `figures` (curves and
aggregates), `illustrations` (maps and actions), `runtime` (bars).
"""
