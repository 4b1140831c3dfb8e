"""What the paper compares HDP with (its section "Baselines and ablations"), as LeRobot policies of their own."""
