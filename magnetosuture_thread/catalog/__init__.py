"""An index of many bags: tables of their figures, queries on them, and a page."""
