"""What tests, benchmarks and chapters need and users do not: wheels do not contain it."""
