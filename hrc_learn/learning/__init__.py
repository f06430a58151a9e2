"""From datasets to models: movement primitives, image Jacobians, metrics, tuning."""
