"""What a run is given: scene folders of the known kinds as cameras, images and points."""
