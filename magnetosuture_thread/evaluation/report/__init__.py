"""The report of one evaluated bag: figures, plots, pictures, and the page that holds them."""
