"""The benchmark: methods x domains x seeds as cells that can be interrupted, rerun alone and spread over machines."""
