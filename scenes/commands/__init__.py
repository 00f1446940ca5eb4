"""The subcommands of `sulcus`, one file each: `HELP`, `add_arguments(parser)` and `run(args) -> exit code`."""
