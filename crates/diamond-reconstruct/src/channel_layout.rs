//! Which feature channels are rasterised, and where they lie.
//!
//! The shader knows fourteen channels ([`diamond_shading::channel`]). A channel that nothing reads, because the
//! configuration replaces it by a constant or leaves its part of the model out, is not rasterised: the others move up.
//! On the way to the shader absent channels become 0, which the shader then does not look at; on the way back their
//! cotangents, which are 0, are dropped.
use crate::region::Region;
use diamond_image::Image;
use diamond_shading::channel;

/// Places of the shader's channels among those that are rasterised.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChannelLayout {
    places: [Option<u8>; channel::COUNT],
    count: usize,
}

impl ChannelLayout {
    /// The channels that are `wanted`, in the shader's order.
    pub fn new(wanted: impl Fn(usize) -> bool) -> Self {
        let mut count = 0;
        let places = std::array::from_fn(|c| {
            wanted(c).then(|| {
                count += 1;
                (count - 1) as u8
            })
        });
        Self { places, count }
    }

    /// All channels.
    pub fn full() -> Self {
        Self::new(|_| true)
    }

    /// Those of these channels that are `wanted`, moved up.
    pub fn filtered(&self, wanted: impl Fn(usize) -> bool) -> Self {
        Self::new(|c| self.places[c].is_some() && wanted(c))
    }

    /// Number of channels that are rasterised.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Where the shader's channel `c` lies, if it is rasterised.
    pub fn place(&self, c: usize) -> Option<usize> {
        self.places[c].map(usize::from)
    }

    /// Writes the shader's channel `c` of a packed row, if it is rasterised.
    pub fn put(&self, row: &mut [f32], c: usize, value: f32) {
        if let Some(place) = self.place(c) {
            row[place] = value;
        }
    }

    /// Reads the shader's channel `c` of a packed row; 0 where it is not rasterised.
    pub fn get(&self, row: &[f32], c: usize) -> f32 {
        self.place(c).map_or(0.0, |place| row[place])
    }

    /// The shader's channels of `region` from what was rasterised.
    pub fn unpack(&self, packed: &Image, region: &Region) -> Image {
        let mut out = Image::new(region.width, region.height, channel::COUNT);
        self.each_row(region, packed.width(), |packed_row, row| {
            let from = packed.data()[packed_row].chunks_exact(self.count.max(1));
            for (to, from) in out.data_mut()[row].chunks_exact_mut(channel::COUNT).zip(from) {
                for (to, place) in to.iter_mut().zip(&self.places) {
                    *to = place.map_or(0.0, |p| from[usize::from(p)]);
                }
            }
        });
        out
    }

    /// Cotangents of the rasterised channels, a picture of `width` × `height`, from those of the shader's channels of
    /// `region`.
    pub fn pack(&self, d: &Image, region: &Region, width: usize, height: usize) -> Image {
        let mut out = Image::new(width, height, self.count);
        self.each_row(region, width, |packed_row, row| {
            let from = d.data()[row].chunks_exact(channel::COUNT);
            for (to, from) in out.data_mut()[packed_row].chunks_exact_mut(self.count.max(1)).zip(from) {
                for (from, place) in from.iter().zip(&self.places) {
                    if let Some(p) = place {
                        to[usize::from(*p)] = *from;
                    }
                }
            }
        });
        out
    }

    /// Calls `f` with the ranges of each row of `region` in a packed picture and in the region's own unpacked image.
    fn each_row(
        &self,
        region: &Region,
        width: usize,
        mut f: impl FnMut(std::ops::Range<usize>, std::ops::Range<usize>),
    ) {
        for y in 0..region.height {
            let packed = ((region.y + y) * width + region.x) * self.count;
            let own = y * region.width * channel::COUNT;
            f(packed..packed + region.width * self.count, own..own + region.width * channel::COUNT);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unpacking_and_packing_are_each_others_reverse() {
        let layout = ChannelLayout::new(|c| c != channel::METALNESS && c != channel::INCIDENT);
        assert_eq!((layout.count(), layout.place(channel::METALNESS)), (12, None));
        assert_eq!(layout.place(channel::VISIBILITY), Some(11));
        let region = Region { x: 1, y: 2, width: 3, height: 2 };
        let packed = Image::from_vec(5, 4, 12, (0..240).map(|v| v as f32 + 1.0).collect()).unwrap();
        let unpacked = layout.unpack(&packed, &region);
        assert_eq!(unpacked.pixel(0, 0)[channel::METALNESS], 0.0);
        assert_eq!(unpacked.pixel(2, 1)[channel::VISIBILITY], packed.pixel(3, 3)[11]);
        let again = layout.pack(&unpacked, &region, 5, 4);
        for y in 0..4 {
            for x in 0..5 {
                let inside = (1..4).contains(&x) && (2..4).contains(&y);
                let expected = if inside { packed.pixel(x, y).to_vec() } else { vec![0.0; 12] };
                assert_eq!(again.pixel(x, y), expected);
            }
        }
        let full = ChannelLayout::full();
        let whole = Image::from_vec(5, 4, 14, (0..280).map(|v| v as f32).collect()).unwrap();
        assert_eq!(full.unpack(&whole, &Region::whole(5, 4)), whole);
    }
}
