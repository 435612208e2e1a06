"""Two hosts, and what happens to the coils when the cable between them is pulled."""
