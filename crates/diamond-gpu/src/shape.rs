//! How large a picture's arrays are, and in how many pieces its channels go through the kernels.
use crate::GpuError;
use crate::frame::TILE;

/// Every array that lives on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Column {
    /// By Gaussian: mean and opacity.
    Means,
    /// By Gaussian: quaternion, or xx, yx, yy, zx of the lower factor.
    FormA,
    /// By Gaussian: standard deviations, or zy, zz of the lower factor.
    FormB,
    /// By piece of channels, then by Gaussian.
    Features,
    /// By Gaussian: [`Splat`](crate::Splat).
    Splats,
    /// By Gaussian: extents, 2τ, y of the rightmost point.
    Outlines,
    /// By Gaussian, then in order: bits of the depth.
    DepthKeys,
    /// Buffer of the sort by depth.
    DepthKeysAlt,
    /// By rank of depth: Gaussian.
    DepthOrder,
    /// Buffer of the sort by depth.
    DepthOrderAlt,
    /// By Gaussian: tiles that it meets.
    TileCounts,
    /// By rank of depth: where the entries begin; one more for their end.
    Offsets,
    /// Gaussians; entries made; entries wanted; visible Gaussians.
    Counts,
    /// By entry: tile.
    TileKeys,
    /// Buffer of the sort by tile.
    TileKeysAlt,
    /// By place in the sorted list: entry.
    Entries,
    /// Buffer of the sort by tile.
    EntriesAlt,
    /// By entry: Gaussian.
    Owners,
    /// Of a sort: by digit and block.
    Histogram,
    /// Sums of a scan's blocks.
    ScanBlocks,
    /// Sums of those.
    ScanBlocks2,
    /// Sums of those.
    ScanBlocks3,
    /// By tile: first and one past last place in the sorted list.
    Ranges,
    /// By place in the sorted list: Gaussian and entry.
    Pairs,
    /// By piece of channels, then by pixel.
    Picture,
    /// By pixel: [`Coverage`](crate::Coverage).
    Coverage,
    /// Cotangent of the picture.
    DPicture,
    /// By pixel: cotangents of opacity and depth.
    DCoverage,
    /// By entry: its share of the sums over pixels.
    Rows,
    /// By Gaussian: sums of g·(1, u, v, u², uv, v²) and w·d depth.
    Moments,
    /// By piece of channels, then by Gaussian.
    DFeatures,
    /// By Gaussian: [`GaussianGrad`](crate::GaussianGrad).
    Gradient,
}

impl Column {
    /// In words, for errors.
    pub fn name(self) -> &'static str {
        match self {
            Column::Means => "means",
            Column::FormA => "rotations",
            Column::FormB => "standard deviations",
            Column::Features => "features",
            Column::Splats => "splats",
            Column::Outlines => "outlines",
            Column::DepthKeys | Column::DepthKeysAlt => "depths",
            Column::DepthOrder | Column::DepthOrderAlt => "order of depth",
            Column::TileCounts => "tiles per Gaussian",
            Column::Offsets => "offsets of entries",
            Column::Counts => "counts",
            Column::TileKeys | Column::TileKeysAlt => "tiles of entries",
            Column::Entries | Column::EntriesAlt => "sorted entries",
            Column::Owners => "Gaussians of entries",
            Column::Histogram => "histogram of a sort",
            Column::ScanBlocks | Column::ScanBlocks2 | Column::ScanBlocks3 => "sums of a scan",
            Column::Ranges => "ranges of tiles",
            Column::Pairs => "lists of tiles",
            Column::Picture => "picture",
            Column::Coverage => "coverage",
            Column::DPicture => "gradient of the picture",
            Column::DCoverage => "gradient of the coverage",
            Column::Rows => "gradients of entries",
            Column::Moments => "moments",
            Column::DFeatures => "gradient of the features",
            Column::Gradient => "gradient of the Gaussians",
        }
    }
}

/// Keys per workgroup of a sort, and numbers per workgroup of a scan.
pub(crate) const BLOCK: u64 = 2048;
/// Channels in a group.
const QUAD: usize = 4;
/// Groups of four channels that go through the kernels together, at most.
const MAX_QUADS: usize = 4;
/// Pieces begin at multiples of so many words: 256 bytes, WebGPU's alignment of a binding.
const ALIGNMENT: u64 = 64;

/// How large a picture's arrays are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// Gaussians.
    pub gaussians: u64,
    /// Width, px.
    pub width: u64,
    /// Height, px.
    pub height: u64,
    /// Channels of the features.
    pub channels: usize,
    /// Groups of four channels in a piece, 1 to 4.
    pub quads: usize,
    /// Pieces of channels, at least 1.
    pub pieces: usize,
    /// Entries (Gaussian, tile) that there is room for.
    pub capacity: u64,
}

impl Shape {
    /// Of a picture, with the channels in pieces so small that no array of a piece is larger than `max_binding` bytes.
    ///
    /// # Errors
    /// An array is larger than that in pieces of four channels.
    pub fn new(
        gaussians: u64,
        size: [u64; 2],
        channels: usize,
        capacity: u64,
        max_binding: u64,
    ) -> Result<Self, GpuError> {
        let groups = channels.div_ceil(QUAD).max(1);
        let mut last = Ok(());
        for at_most in (1..=MAX_QUADS).rev() {
            let pieces = groups.div_ceil(at_most);
            let quads = groups.div_ceil(pieces);
            let shape = Self { gaussians, width: size[0], height: size[1], channels, quads, pieces, capacity };
            last = shape.check(max_binding);
            if last.is_ok() {
                return Ok(shape);
            }
        }
        Err(last.err().unwrap_or(GpuError::NoAdapter))
    }

    fn check(&self, limit: u64) -> Result<(), GpuError> {
        for column in [Column::Splats, Column::Gradient, Column::Pairs, Column::Rows, Column::Coverage] {
            let needed = self.words(column) * 4;
            if needed > limit {
                return Err(GpuError::Limit { what: column.name(), needed, limit });
            }
        }
        for (column, piece) in
            [(Column::Features, self.piece(Column::Features)), (Column::Picture, self.piece(Column::Picture))]
        {
            if piece * 4 > limit {
                return Err(GpuError::Limit { what: column.name(), needed: piece * 4, limit });
            }
        }
        Ok(())
    }

    /// Pixels.
    pub fn pixels(&self) -> u64 {
        self.width * self.height
    }

    /// Columns and rows of tiles.
    pub fn tiles(&self) -> [u64; 2] {
        [self.width.div_ceil(TILE.into()), self.height.div_ceil(TILE.into())]
    }

    /// Digits of eight bits that a tile's number has, with the number one past the last.
    pub(crate) fn tile_digits(&self) -> u32 {
        let [x, y] = self.tiles();
        (64 - (x * y).leading_zeros()).div_ceil(8).max(1)
    }

    /// Where the sorted tiles and entries end up.
    pub fn sorted(&self) -> (Column, Column) {
        if self.tile_digits().is_multiple_of(2) {
            (Column::TileKeys, Column::Entries)
        } else {
            (Column::TileKeysAlt, Column::EntriesAlt)
        }
    }

    /// Words of a piece of channels, before padding; whole for arrays that have no pieces.
    pub(crate) fn piece(&self, column: Column) -> u64 {
        let quads = (QUAD * self.quads) as u64;
        match column {
            Column::Features | Column::DFeatures => self.gaussians.max(1) * quads,
            Column::Picture | Column::DPicture => self.pixels() * quads,
            other => self.words(other),
        }
    }

    /// First word of a piece.
    pub(crate) fn first(&self, column: Column, piece: usize) -> u64 {
        self.piece(column).next_multiple_of(ALIGNMENT) * piece as u64
    }

    /// Blocks of a sort or a scan of so many numbers.
    pub(crate) fn blocks(n: u64) -> u64 {
        n.div_ceil(BLOCK).max(1)
    }

    /// Length of an array, 32-bit words.
    pub fn words(&self, column: Column) -> u64 {
        // No binding may be empty.
        let (n, m) = (self.gaussians.max(1), self.capacity.max(1));
        let [x, y] = self.tiles();
        let scanned = 256 * Self::blocks(n.max(m));
        match column {
            Column::Means | Column::FormA | Column::FormB | Column::Outlines => 4 * n,
            Column::Features | Column::DFeatures | Column::Picture | Column::DPicture => {
                self.first(column, self.pieces)
            }
            Column::Splats => 12 * n,
            Column::DepthKeys | Column::DepthKeysAlt | Column::DepthOrder | Column::DepthOrderAlt => n,
            Column::TileCounts => n,
            Column::Offsets => self.gaussians + 1,
            Column::Counts => 4,
            Column::TileKeys | Column::TileKeysAlt | Column::Entries | Column::EntriesAlt | Column::Owners => m,
            Column::Histogram => scanned,
            Column::ScanBlocks => Self::blocks(scanned.max(n + 1)),
            Column::ScanBlocks2 => Self::blocks(self.words(Column::ScanBlocks)),
            Column::ScanBlocks3 => Self::blocks(self.words(Column::ScanBlocks2)),
            Column::Ranges => 2 * x * y,
            Column::Pairs => 2 * m,
            Column::Coverage => 4 * self.pixels(),
            Column::DCoverage => 2 * self.pixels(),
            Column::Rows => m * self.row_words(),
            Column::Moments => 8 * n,
            Column::Gradient => 16 * n,
        }
    }

    /// Words of an entry's row: eight of geometry, then a piece's channels.
    pub(crate) fn row_words(&self) -> u64 {
        8 + (QUAD * self.quads) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_go_in_even_pieces() {
        let of = |channels| {
            let shape = Shape::new(10, [20, 20], channels, 100, 1 << 27).unwrap();
            (shape.quads, shape.pieces)
        };
        assert_eq!([of(0), of(1), of(16), of(17), of(20), of(33)], [(1, 1), (1, 1), (4, 1), (3, 2), (3, 2), (3, 3)]);
    }

    #[test]
    fn pieces_shrink_until_they_fit_and_then_it_is_an_error() {
        let entries = 2_000_000;
        let wide = Shape::new(1000, [64, 64], 16, entries, 1 << 30).unwrap();
        let narrow = Shape::new(1000, [64, 64], 16, entries, 1 << 27).unwrap();
        assert_eq!((wide.quads, wide.pieces, narrow.quads, narrow.pieces), (4, 1, 2, 2));
        assert!(narrow.words(Column::Rows) * 4 <= 1 << 27);
        let error = Shape::new(1000, [64, 64], 16, 4_000_000, 1 << 27).unwrap_err();
        assert!(matches!(error, GpuError::Limit { what: "gradients of entries", .. }), "{error}");
        let error = Shape::new(3_000_000, [64, 64], 3, 100, 1 << 27).unwrap_err();
        assert!(matches!(error, GpuError::Limit { what: "splats" | "gradient of the Gaussians", .. }), "{error}");
    }

    #[test]
    fn tiles_are_sorted_by_as_many_digits_as_they_have() {
        let digits = |w, h| Shape::new(1, [w, h], 1, 1, 1 << 30).unwrap().tile_digits();
        // One number more than tiles: that of no tile.
        assert_eq!([digits(1, 1), digits(16 * 15, 16 * 17), digits(256, 256), digits(4096, 4096)], [1, 1, 2, 3]);
    }
}
