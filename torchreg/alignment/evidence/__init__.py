"""How far a pose can be trusted: covariance, evidence against it, calibrated confidence."""
