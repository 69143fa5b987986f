//! Changes to a recipe from the command line: `rig.views=4` says the same as the line `views = 4` under `[rig]`.
use crate::SynthError;
use toml::{Table, Value};

/// The table of a recipe's or a family's TOML with changes of the form `key=value` made to it, in order. Keys have the names of the tables around them before
/// them, with dots; values are TOML, or text where they are not. `origin` names the recipe in errors.
///
/// # Errors
/// [`SynthError::Recipe`] for text that is no TOML and for changes of another form.
pub fn changed_table(text: &str, origin: &str, changes: &[String]) -> Result<Table, SynthError> {
    let fail = |detail: String| SynthError::Recipe { origin: origin.into(), detail };
    let mut table: Table = toml::from_str(text).map_err(|e| fail(e.to_string()))?;
    for change in changes {
        let expected = || fail(format!("expected a change such as rig.views=4, found {change:?}"));
        let (key, value) = change.split_once('=').ok_or_else(expected)?;
        let (key, value) = (key.trim(), value.trim());
        let parsed = toml::from_str::<Table>(&format!("value = {value}")).ok().and_then(|mut t| t.remove("value"));
        let value = parsed.unwrap_or_else(|| Value::String(value.into()));
        let mut parts: Vec<&str> = key.split('.').collect();
        let last = parts.pop().filter(|last| !last.is_empty()).ok_or_else(expected)?;
        let mut at = &mut table;
        for part in parts {
            let inner = at.entry(part).or_insert_with(|| Value::Table(Table::new()));
            at = inner
                .as_table_mut()
                .ok_or_else(|| fail(format!("{change}: expected a table with the name {part}, found a value")))?;
        }
        at.insert(last.into(), value);
    }
    Ok(table)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_replaced_and_added_and_mistakes_named() {
        let text = "name = \"x\"\nseed = 1\n[rig]\nviews = 2\n";
        let of = |changes: &[&str]| {
            changed_table(text, "x.toml", &changes.iter().map(|c| c.to_string()).collect::<Vec<_>>())
        };
        let table =
            of(&["rig.views=4", "film.resolution = 32", "name=a candle", "material.sigma_t=[1, 2, 3]"]).unwrap();
        assert_eq!(table["rig"]["views"].as_integer(), Some(4));
        assert_eq!(table["film"]["resolution"].as_integer(), Some(32));
        assert_eq!(table["name"].as_str(), Some("a candle"));
        assert_eq!(table["material"]["sigma_t"].as_array().unwrap().len(), 3);
        assert!(of(&["rig.views"]).unwrap_err().to_string().contains("x.toml: expected a change such as"));
        assert!(of(&["seed.x=1"]).unwrap_err().to_string().contains("expected a table with the name seed"));
        assert!(of(&["=1"]).is_err());
    }
}
