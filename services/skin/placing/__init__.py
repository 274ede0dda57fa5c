"""`penumbra skin place`: where pads should sit, and how many, judged by what their field model can tell about a limb's pose."""
