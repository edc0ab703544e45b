"""The closed loop on virtual printers: print, scan, inspect, redesign, print the redesign, and so on."""
