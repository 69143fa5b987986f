//! The recipes under `assets/recipes` are valid and their objects closed.
use diamond_synth::{Family, Object, ObjectRecipe, Plan, Recipe};
use std::path::Path;

#[test]
fn shipped_recipes_make_closed_objects() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/recipes");
    let mut named = 0;
    for entry in std::fs::read_dir(&folder).unwrap() {
        let path = entry.unwrap().path();
        let text = std::fs::read_to_string(&path).unwrap();
        let origin = path.display().to_string();
        if path.file_name().is_some_and(|name| name.to_string_lossy().ends_with("-family.toml")) {
            let family = Family::parse(&text, &origin).unwrap();
            assert!(family.count >= 100);
            for member in family.members().take(12) {
                let object = Object::new(&member, &folder).unwrap();
                assert!(object.mesh.is_closed(), "{}", member.name);
            }
            continue;
        }
        let recipe = Recipe::parse(&text, &origin).unwrap();
        named += 1;
        assert!(Plan::new(&recipe).unwrap().images() > 0);
        // Its mesh is the user's.
        if matches!(recipe.object, ObjectRecipe::Mesh { .. }) {
            continue;
        }
        let object = Object::new(&recipe, &folder).unwrap();
        assert!(object.mesh.is_closed() && object.mesh.signed_volume() > 0.01, "{origin}");
        assert_eq!(object.repairs.components, 1, "{origin}: {}", object.repairs);
    }
    assert!(named >= 8, "{named} recipes");
}
