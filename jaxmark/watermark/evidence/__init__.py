"""What a reading proves: `bounds` has formulas, `ledger` what each choice costs, `detection` the result."""
