"""Test Tube Insertion: a tube goes into a rack that the other hand holds."""

from taccorl.tasks.test_tube.scene import TestTube as TestTube
