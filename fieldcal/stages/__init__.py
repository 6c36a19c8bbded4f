"""The stages: columns ↔ arrays around the numerics, one short function each, in order in `pipeline.PIPELINE`.

A stage is `run(tables, settings) -> StageResult`. `tables` holds the inputs that `Stage.reads` names (missing ones
are absent), `settings` only the entries that `Stage.settings` names. No stage knows of files, flows or other stages'
storage.
"""
