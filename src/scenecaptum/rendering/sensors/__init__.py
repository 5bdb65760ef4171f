"""One module for each type of sensor in ``SENSORS``; imported only once a variant is active."""
