"""The local web app `kerv board`: what a results folder holds, in a browser (docs/board.md)."""
