# Plays a skinned glTF in Godot 4: add this script to a Node3D.
#
#     python -m clothjax render skirt --motions dance_3 --out skirt.glb --skinned
extends Node3D

@export_file("*.glb") var path := "res://skirt.glb"


func _ready() -> void:
	var state := GLTFState.new()
	var document := GLTFDocument.new()
	var error := document.append_from_file(path, state)
	if error != OK:
		push_error("%s: %s" % [path, error_string(error)])
		return
	var character := document.generate_scene(state)
	add_child(character)
	var player: AnimationPlayer = character.find_children("*", "AnimationPlayer", true, false)[0]
	var clip := player.get_animation_list()[0]
	player.get_animation(clip).loop_mode = Animation.LOOP_LINEAR
	player.play(clip)
