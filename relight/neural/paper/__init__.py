"""The preset `paper`: Sevastopolsky et al. 2020 as written; where it is silent, docs/decisions/0019 says what
is done."""
