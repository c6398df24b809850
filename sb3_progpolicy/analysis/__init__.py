"""Programs made small and checked: simplification to the fewest terms, and verification from all starts."""
