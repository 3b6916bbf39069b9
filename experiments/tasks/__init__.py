"""The tasks of trials, one module each: ``run(config, bench)`` returns a `TrialOutcome`."""
