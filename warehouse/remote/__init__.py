"""A warehouse by URL: truth lies in the object store, the code beside this works on a local copy of it (decision 9).

`heads/<vehicle>.json` names the files that a vehicle's history is; it alone is ever replaced, by compare-and-swap.
`objects/` has these files, immutable, by their sha256. `tables/` has copies of the live ones for whoever reads
Parquet without us.
"""
