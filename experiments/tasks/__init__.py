"""What trials do, one module per task: ``run(config, bench)`` returns a `TrialOutcome`."""
