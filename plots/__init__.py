"""Tables and figures of the benchmark; `plot.py` is the command. Each file has one job.

`paper` has the paper's names, colours and numbers. `others` reads results from several sources, `grouping` puts runs
together that differ only in the seed, and `conflicts` separates runs of different definitions. `rewards`,
`definitions` and `starts` make tables, `reproduced` makes those of README and docs/results.md. `style` sets the look of
figures, `figures` draws curves. `statistics` and `aggregates` compare algorithms over tasks, in numbers, tables and
figures. `illustrations` draws maps and actions, `runtime` the runtime experiment.
"""
