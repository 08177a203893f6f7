import os


def searchForMaxIteration(folder):
    return max(int(name.rpartition("_")[2]) for name in os.listdir(folder))
