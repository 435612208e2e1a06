"""The report of one bag: what is kept of it, what is drawn, and the page."""
