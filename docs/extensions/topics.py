"""Topics of the public names: the order of the reference pages."""

TOPICS = {
    "sim": {
        "Meshes and anatomies": """TetMesh Anatomy Body OpenCortex Place Subject Tumour Lobed MeshPlan MeshFile
            MeshWarning read_mesh write_mesh read_anatomy write_anatomy make_anatomy open_cortex build_volume_subject
            build_template_subject refine""",
        "Tissue": "Material Ogden Tissue BRAIN MATERIALS Law check_tissue",
        "Loads": """Loads Pushed Touching Displaced Nodal Prescribed Posture Retracted Resected push build_posture
            stack""",
        "Tools": "Ball Capsule Spatula Core",
        "Effects of a scene": """Elasticity Held Bonded Slide SkullContact ToolForce ToolContact ToolDisplacement
            NodalForce Gravity Inertia Pulsation Resection Retraction build_push_effects""",
        "Solver": """Fem build_fem build_family FAMILIES Deformer Deformation Outcome Cost Accuracy DRAFT LIVE TRAIN
            REFERENCE InputError""",
        "Derived results": "compute_pressure solve_with_debonding DebondedSolution differentiate_equilibrium "
        "compute_jacobian EquilibriumGradient solve_equilibrium",
        "Extension": "OwnEffect OwnCause OwnTool Term Cases",
    },
    "surrogate": {
        "Data sets": "draw draw_poses simulate Dataset read_dataset",
        "Models": "train Trained Learned Guarded load save build_onnx_model write_onnx",
        "Evaluation": "score Score compute_coverage Coverage",
        "Tumour position from observations": """Locator make_locator load_locator save_locator Location Observation
            read_observation""",
        "Tissue of a patient": "fit_tissue FittedTissue load_tissue save_tissue ObservedFrame Tool read_tools",
        "Extension": "Regressor register_learner",
    },
    "ar": {
        "Cameras": "Camera Lens look_at build_stereo_pair",
        "Rendering": "render Renderer rasterise Picture Pictures Layer Solid Lamp build_lamp",
        "Overlay": "composite Overlaid",
        "Output": "Browser read_png write_png write_video",
    },
    "scenes": {
        "Scenes": """Scene find_scene Bounds Player Frame PatientSetup open_theatre CraniotomyFrame
            build_craniotomy_frame get_template_path""",
        "Tool motion": """Touch press slide palpate stroke_cortex keep_idle draw lay Instrument Probe Blade Debulking
            HeadPose""",
        "Cameras": "Viewpoint HandHeld Microscope Orbit Focus read_calibration write_calibration",
        "Observation of the cortex": "PointObservation StereoObservation",
        "Episodes": "collect Episodes EpisodeDataset read_episodes write_card",
    },
}
"""Names by topic and package; each public name stands once."""
