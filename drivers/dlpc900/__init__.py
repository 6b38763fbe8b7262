"""DLPC900 controllers (TI LightCrafter 6500 and 9000) as spatial light modulators over USB HID.

Source: TI, *DLPC900 Programmer's Guide*, DLPU018 (revisions I and J); section numbers below are its.
"""
