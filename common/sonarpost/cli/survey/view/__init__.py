"""`sonarpost survey view`: a local web page with the waterfall of a recording, for picks."""
