"""The commands of `relight`, one module each, named in `relight.cli`.

A command module has `add_arguments(parser)`, `EXAMPLE` for its help, and `run(args)`, which returns when the
work is done and raises otherwise. Heavy imports stay inside `run`: help and usage errors come at once.
"""
