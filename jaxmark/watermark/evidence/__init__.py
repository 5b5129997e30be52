"""What a reading proves: `bounds` has formulas, `ledger` what each choice after the suspect costs, `detection` the result."""
