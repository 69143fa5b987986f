//! Typed access to the fields of a JSON file, with errors that name file, frame and field.
use crate::{DatasetError, Place};
use glam::{Mat4, Vec3};
use serde_json::Value;

/// The largest coordinate that is accepted, scene units: squared lengths must stay finite in `f32`.
const MAX_COORDINATE: f32 = 1e15;

/// A JSON object and where it stands.
#[derive(Clone, Copy)]
pub(crate) struct Object<'a> {
    map: &'a serde_json::Map<String, Value>,
    file: &'a std::path::Path,
    frame: Option<usize>,
}

/// A JSON value in a few words, for error messages.
fn describe(value: &Value) -> String {
    match value {
        Value::Array(items) if items.len() > 4 => format!("an array of {} entries", items.len()),
        Value::Object(map) => format!("an object with {} keys", map.len()),
        other => {
            let text = other.to_string();
            if text.chars().count() > 60 { text.chars().take(57).chain("...".chars()).collect() } else { text }
        }
    }
}

/// The JSON value of a text, or where its first mistake is.
pub(crate) fn parse_json(path: &std::path::Path, text: &str) -> Result<Value, DatasetError> {
    serde_json::from_str(text).map_err(|e| DatasetError::Json {
        path: path.to_path_buf(),
        line: e.line(),
        column: e.column(),
        reason: e.to_string(),
    })
}

impl<'a> Object<'a> {
    /// The object `value`; an error where it is none.
    pub(crate) fn new(
        value: &'a Value,
        file: &'a std::path::Path,
        frame: Option<usize>,
        what: &str,
    ) -> Result<Self, DatasetError> {
        match value {
            Value::Object(map) => Ok(Self { map, file, frame }),
            other => Err(DatasetError::Field {
                place: Place { file: file.to_path_buf(), frame, field: None }.into(),
                expected: what.to_string(),
                found: describe(other),
                advice: "see the capture layout in the documentation",
            }),
        }
    }

    /// The place of a field of this object.
    pub(crate) fn place(&self, field: impl Into<String>) -> Place {
        Place { file: self.file.to_path_buf(), frame: self.frame, field: Some(field.into()) }
    }

    /// An error about a field of this object.
    pub(crate) fn error(
        &self,
        field: impl Into<String>,
        expected: impl Into<String>,
        found: impl Into<String>,
        advice: &'static str,
    ) -> DatasetError {
        DatasetError::Field { place: self.place(field).into(), expected: expected.into(), found: found.into(), advice }
    }

    /// The value of a field; JSON `null` counts as absent.
    pub(crate) fn get(&self, field: &str) -> Option<&'a Value> {
        self.map.get(field).filter(|v| !v.is_null())
    }

    /// An array field.
    pub(crate) fn array(&self, field: &str) -> Result<Option<&'a [Value]>, DatasetError> {
        match self.get(field) {
            None => Ok(None),
            Some(Value::Array(items)) => Ok(Some(items)),
            Some(other) => {
                Err(self.error(field, "an array", describe(other), "write [..], with one entry per image of the frame"))
            }
        }
    }

    /// A finite number field.
    pub(crate) fn number(&self, field: &str) -> Result<Option<f64>, DatasetError> {
        self.get(field).map(|v| self.as_number(v, field)).transpose()
    }

    /// A value as a finite number that an `f32` can hold.
    pub(crate) fn as_number(&self, value: &Value, field: &str) -> Result<f64, DatasetError> {
        match value.as_f64() {
            Some(v) if (v as f32).is_finite() => Ok(v),
            _ => Err(self.error(field, "a finite number", describe(value), "correct the value")),
        }
    }

    /// A positive whole number field (an image size); `1920.0` counts as whole.
    pub(crate) fn size(&self, field: &str) -> Result<Option<u32>, DatasetError> {
        let Some(v) = self.number(field)? else { return Ok(None) };
        if v < 1.0 || v > f64::from(u32::MAX) || v.fract() != 0.0 {
            return Err(self.error(
                field,
                "a positive whole number of pixels",
                v.to_string(),
                "correct the value, or remove the field to take the size from the image",
            ));
        }
        Ok(Some(v as u32))
    }

    /// A value as a string.
    pub(crate) fn as_text(&self, value: &'a Value, field: &str) -> Result<&'a str, DatasetError> {
        value.as_str().ok_or_else(|| self.error(field, "a string", describe(value), "put the value in quotes"))
    }

    /// A value as three finite numbers.
    pub(crate) fn as_vec3(&self, value: &Value, field: &str) -> Result<Vec3, DatasetError> {
        let bad = || {
            let expected = "three finite numbers [x, y, z]";
            self.error(field, expected, describe(value), "correct the value, or leave this image out of the frame")
        };
        let items = value.as_array().filter(|items| items.len() == 3).ok_or_else(bad)?;
        let mut v = [0.0f32; 3];
        for (out, item) in v.iter_mut().zip(items) {
            *out = item.as_f64().map(|x| x as f32).filter(|x| x.abs() <= MAX_COORDINATE).ok_or_else(bad)?;
        }
        Ok(Vec3::from(v))
    }

    /// A value as an intensity: three finite numbers ≥ 0, or one for all channels.
    pub(crate) fn as_intensity(&self, value: &Value, field: &str) -> Result<Vec3, DatasetError> {
        let rgb = match value {
            Value::Number(_) => Vec3::splat(self.as_number(value, field)? as f32),
            _ => self.as_vec3(value, field)?,
        };
        if rgb.min_element() < 0.0 {
            return Err(self.error(field, "an intensity of at least 0", describe(value), "correct the value"));
        }
        Ok(rgb)
    }

    /// A 4×4 (or 3×4) matrix field, written row by row.
    pub(crate) fn matrix(&self, field: &str) -> Result<Mat4, DatasetError> {
        const SHAPE: &str = "a 4×4 matrix of finite numbers, row by row";
        const ADVICE: &str = "write the camera-to-world matrix in OpenGL axes, or leave the frame out";
        let value = self.get(field).ok_or_else(|| self.error(field, SHAPE, "nothing", ADVICE))?;
        let bad = |found: String| self.error(field, SHAPE, found, ADVICE);
        let rows = value.as_array().ok_or_else(|| bad(describe(value)))?;
        if rows.len() != 4 && rows.len() != 3 {
            return Err(bad(format!("{} rows", rows.len())));
        }
        let mut m = [[0.0f32; 4], [0.0; 4], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];
        for (r, row) in rows.iter().enumerate() {
            let items = row
                .as_array()
                .filter(|items| items.len() == 4)
                .ok_or_else(|| bad(format!("row {r}: {}", describe(row))))?;
            for (c, item) in items.iter().enumerate() {
                m[r][c] = item
                    .as_f64()
                    .map(|x| x as f32)
                    .filter(|x| x.abs() <= MAX_COORDINATE)
                    .ok_or_else(|| bad(format!("{} in row {r}, column {c}", describe(item))))?;
            }
        }
        Ok(Mat4::from_cols_array_2d(&m).transpose())
    }
}
