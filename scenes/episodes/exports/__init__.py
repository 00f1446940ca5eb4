"""Episodes in the formats of others: LeRobot, robomimic, folders of pictures, XDMF; and the card of a data set."""
