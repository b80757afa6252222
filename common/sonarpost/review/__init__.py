"""What an operator's review needs besides the records: grouping, measuring, costs, pictures for the eye. Pure."""
