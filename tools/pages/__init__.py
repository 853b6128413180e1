"""What the tools that write pages of the docs share: scenes, trainings, figures and how a page is made from them."""
