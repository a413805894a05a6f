"""Tables and figures of the benchmark; `plot.py` is the command. Each file has one job.

`paper` has the names, colours and numbers of the paper, `grouping` says which runs belong together, and `style` is the
look of figures. `rewards` and `definitions` fill tables, `figures` draws curves. `statistics` and `aggregates` compare
algorithms over tasks, in numbers, tables and figures. `illustrations` draws maps and actions, `runtime` the runtime
experiment.
"""
