"""The `rainstereo` command: one module per subcommand, reports, benchmarks."""
