"""Export of episodes to LeRobot, robomimic, folders of images and XDMF, and the card of a data set."""
