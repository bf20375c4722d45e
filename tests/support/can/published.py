"""Published figures of CAN buses: lengths of frames, response times."""

MS = 1_000_000
US = 1_000

# The SAE benchmark in the packing of Tindell & Burns, 17 messages, most urgent first: period [ms],
# data bytes, worst response to the end of EOF at 125, 250, 500 and 1000 kbit/s [us]. Source:
# can-physics, 6.5: the first column recalled from the papers, all recomputed by hand.
SAE_RATES = (125_000, 250_000, 500_000, 1_000_000)
SAE = (
    (1000, 1, 1416, 708, 354, 177),
    (5, 2, 2016, 1008, 504, 252),
    (5, 1, 2536, 1268, 634, 317),
    (5, 2, 3136, 1568, 784, 392),
    (5, 1, 3656, 1828, 914, 457),
    (5, 2, 4256, 2128, 1064, 532),
    (10, 6, 5016, 2508, 1254, 627),
    (10, 1, 8376, 2768, 1384, 692),
    (10, 2, 8976, 3068, 1534, 767),
    (10, 2, 9576, 3368, 1684, 842),
    (100, 1, 10096, 3628, 1814, 907),
    (100, 4, 19096, 3968, 1984, 992),
    (100, 1, 19616, 4228, 2114, 1057),
    (100, 1, 20136, 4488, 2244, 1122),
    (1000, 3, 28976, 4748, 2374, 1187),
    (1000, 1, 29496, 5008, 2504, 1252),
    (1000, 1, 29496, 5008, 2504, 1252),
)

# Bits with intermission, shortest and longest, 11-bit and 29-bit identifiers, by
# data bytes.
# Source: Linux include/linux/can/length.h (can-physics, 6.3).
FD_BITS = {
    0: (62, 67, 81, 91),
    8: (126, 147, 145, 171),
    12: (158, 187, 177, 211),
    16: (190, 227, 209, 251),
    20: (227, 272, 246, 296),
    24: (259, 312, 278, 336),
    32: (323, 392, 342, 416),
    48: (451, 552, 470, 576),
    64: (579, 712, 598, 736),
}
