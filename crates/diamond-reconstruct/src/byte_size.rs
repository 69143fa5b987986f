//! Amounts of memory as people write them: `512 MiB`, `2 GiB`, `1.5GB`, or plain bytes.
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use std::str::FromStr;

/// An amount of memory, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct ByteSize(pub u64);

/// Units and their bytes; the first that divides an amount names it. Short and decimal ones are read, not written.
const UNITS: [(&str, u64); 12] = [
    ("TiB", 1 << 40),
    ("GiB", 1 << 30),
    ("MiB", 1 << 20),
    ("KiB", 1 << 10),
    ("TB", 1_000_000_000_000),
    ("GB", 1_000_000_000),
    ("MB", 1_000_000),
    ("kB", 1000),
    ("G", 1 << 30),
    ("M", 1 << 20),
    ("K", 1 << 10),
    ("B", 1),
];
/// Of them, those that are written.
const WRITTEN: usize = 4;

impl ByteSize {
    /// Rounded to a thousandth of the unit: for messages.
    pub fn rounded(self) -> String {
        let unit = UNITS[..WRITTEN].iter().find(|(_, bytes)| self.0 >= *bytes);
        match unit {
            None => format!("{} B", self.0),
            Some((name, bytes)) => {
                let amount = self.0 as f64 / *bytes as f64;
                if amount < 10.0 { format!("{amount:.1} {name}") } else { format!("{amount:.0} {name}") }
            }
        }
    }
}

impl fmt::Display for ByteSize {
    /// Exact: a whole number of the largest unit that divides it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match UNITS[..WRITTEN].iter().find(|(_, bytes)| self.0 > 0 && self.0.is_multiple_of(*bytes)) {
            Some((name, bytes)) => write!(f, "{} {name}", self.0 / bytes),
            None => write!(f, "{} B", self.0),
        }
    }
}

impl FromStr for ByteSize {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let fail = || {
            let shown: String = text.chars().take(40).collect();
            format!("expected an amount of memory such as \"512 MiB\", \"2 GiB\" or bytes, found {shown:?}")
        };
        let text = text.trim();
        let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
        let (number, unit) = (&text[..end], text[end..].trim());
        let bytes = match unit {
            "" => 1,
            unit => UNITS.iter().find(|(name, _)| name.eq_ignore_ascii_case(unit)).ok_or_else(fail)?.1,
        };
        if let Ok(whole) = number.parse::<u64>() {
            return whole.checked_mul(bytes).map(ByteSize).ok_or_else(fail);
        }
        let amount = number.parse::<f64>().map_err(|_| fail())? * bytes as f64;
        // Beyond 2⁵³ fractions of bytes make no sense, and no machine has as much.
        if (0.0..9e15).contains(&amount) { Ok(ByteSize(amount.round() as u64)) } else { Err(fail()) }
    }
}

impl Serialize for ByteSize {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ByteSize {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Written {
            Bytes(u64),
            Text(String),
        }
        let expected = "expected an amount of memory such as \"512 MiB\", \"2 GiB\" or a number of bytes";
        match Written::deserialize(deserializer).map_err(|_| serde::de::Error::custom(expected))? {
            Written::Bytes(bytes) => Ok(ByteSize(bytes)),
            Written::Text(text) => text.parse().map_err(serde::de::Error::custom),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amounts_are_read_and_written() {
        for (text, bytes) in [
            ("512 MiB", 512u64 << 20),
            ("2GiB", 2 << 30),
            ("1.5 GiB", 3 << 29),
            ("750mb", 750_000_000),
            ("64k", 64 << 10),
            (" 4096 ", 4096),
            ("12 B", 12),
            ("0", 0),
        ] {
            let size: ByteSize = text.parse().unwrap();
            assert_eq!(size, ByteSize(bytes), "{text}");
            assert_eq!(size.to_string().parse(), Ok(size), "{size}");
        }
        for text in ["", "MiB", "-1", "1 XiB", "1e3", "inf", "99999999999 TiB", "99999999999.5 TiB", "1.2.3 GiB"] {
            assert!(text.parse::<ByteSize>().unwrap_err().contains("512 MiB"), "{text}");
        }
        assert_eq!(ByteSize(1536 << 20).to_string(), "1536 MiB");
        assert_eq!(
            [0, 999, 1536 << 20, 100 << 20].map(|b| ByteSize(b).rounded()),
            ["0 B", "999 B", "1.5 GiB", "100 MiB"]
        );
    }
}
