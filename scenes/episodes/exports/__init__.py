"""Episodes in other formats: LeRobot, robomimic, folders of images, XDMF; and the card of a data set."""
