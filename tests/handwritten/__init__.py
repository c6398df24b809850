"""Small programs written by hand in our grammar: proof that the policy class can express each domain's solution."""
