"""The report of a campaign: one page that loads nothing."""
